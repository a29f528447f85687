"""The loop over ticks, and between them."""
