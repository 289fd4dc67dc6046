"""What every adapter must do, as tests that an adapter of anybody can run: see docs/add_a_robot.md."""
