"""The rooms of register_node."""
