"""A whole diagram as functions of (t, x, w, p)."""
