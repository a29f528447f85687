"""Stages of a trial run: in a file of their own, so that importing the package doesn't load the script `trial`."""

STAGES = {
    "load": "loading and instantiating it",
    "initialize": "initializing it",
    "step": "its first step",
    "get": "getting its outputs",
    "terminate": "terminating it",
}
