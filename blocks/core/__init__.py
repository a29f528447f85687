"""The base of all blocks: ports, signals, values, units and errors."""
