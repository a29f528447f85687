"""Margins, Nyquist, disks and pole placement of linear systems."""
