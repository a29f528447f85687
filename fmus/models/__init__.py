"""Plants of the library."""
