"""What is learned from what: LightningModules and their losses."""
