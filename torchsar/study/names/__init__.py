"""What a config may name: stages, scenes, motions, impairments and the like."""
