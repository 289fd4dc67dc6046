"""Studies that a plant asks of a gauge: repeatability, R&R, direction of approach, drift, correlation with a reference."""
