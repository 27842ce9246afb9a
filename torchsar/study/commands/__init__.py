"""The commands, each written once for every system."""
