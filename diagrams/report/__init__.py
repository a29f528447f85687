"""The general design report."""
