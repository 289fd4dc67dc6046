"""Planning and recording: cell file, feasible poses, finding the sphere, the capture run, writing sessions."""
