"""Physical things and their files: robots, cameras, robot models, kinematics, file readers, the simulated cell."""
