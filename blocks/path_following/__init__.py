"""Blocks of the paper: transverse coordinates, compliance, environments and planar models."""
