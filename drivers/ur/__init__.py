"""Universal Robots over RTDE, with the package `ur-rtde` in a child process: see `drivers.ur_rtde`."""
