"""The contract of a block, checked."""
