"""Inspection, validation and trial runs of FMUs."""
