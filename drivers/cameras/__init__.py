"""Cameras that drop RAW files into a folder."""
