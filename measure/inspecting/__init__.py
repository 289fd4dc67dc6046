"""Inspection of a stitched cloud against a nominal: alignment, deviations, features, tolerances, verdict.

The folder is not called `inspect`, which is a module of Python itself: with measure/ on the path it would hide it.
"""
