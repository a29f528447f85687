"""Statuses of FMI's functions (FMI 2.0, 2.1.3; FMI 3.0, 2.2.3), as numbers."""

STATUS = ("OK", "warning", "discard", "error", "fatal", "pending")
WARNING, DISCARD, ERROR, FATAL, PENDING = range(1, 6)
