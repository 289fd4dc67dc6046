"""The history of a cell: calibrations, checks and verifications in a database that only grows (docs/history.md)."""
