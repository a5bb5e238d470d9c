"""Clean sources, clips and the pair maker."""
