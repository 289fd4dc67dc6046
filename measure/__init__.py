"""Using the calibrated cell: verify, stitch, report, viewer, and the command `spherecal`."""
