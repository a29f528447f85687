"""FMU files: their description, read and checked."""
