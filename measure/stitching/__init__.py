"""The parts of stitching: scans examined and moved, tiles on disk, files of other programs, registration."""
