"""The block `Fmu` and its linear model."""
