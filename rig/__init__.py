"""The bench, sweeps, runs on disk and the `rig` command."""
