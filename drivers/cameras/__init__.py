"""Adapters of 3D cameras, one module each; none yet."""
