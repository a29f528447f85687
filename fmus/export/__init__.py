"""Export of a block as an FMU: equations, C code, model description, binaries."""
