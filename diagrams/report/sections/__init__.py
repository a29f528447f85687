"""Sections of a report about any diagram; each file makes one."""
