"""The quick check: a few shots of spheres that still stand as they were calibrated, and what has changed since."""
