"""The `rig` command, one module per verb."""
