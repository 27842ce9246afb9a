"""Names that a config may use: stages, scenes, motions, impairments and the like."""
