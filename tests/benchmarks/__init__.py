"""Benchmarks: they print figures and ratios; none is a test."""
