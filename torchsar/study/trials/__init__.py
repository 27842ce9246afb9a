"""What experiments are made of: a system, its bench, batches of trials, outcomes of methods."""
