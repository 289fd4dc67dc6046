"""Unattended production: one job a part, each done exactly once in effect, whatever is killed meanwhile (docs/jobs.md)."""
