"""FMI calls into a library that is loaded in this process."""
