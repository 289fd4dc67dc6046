"""The parts of a proof of accuracy: what was really unseen, probing, lengths, what a test's own uncertainty is."""
