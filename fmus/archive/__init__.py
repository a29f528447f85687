"""An FMU file: its description, read and checked."""
