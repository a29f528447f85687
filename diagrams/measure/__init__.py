"""Frequency responses measured on a running diagram."""
