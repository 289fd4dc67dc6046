"""Readers of the files that spherecal lives on: YAML 1.2, PLY clouds, sessions."""
