"""Structure of a diagram: blocks, wires, subsystems, checks and the order of evaluation."""
