"""FMI calls of a library that is loaded in this process."""
