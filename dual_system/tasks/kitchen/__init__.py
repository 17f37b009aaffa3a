"""RoboCasa-DC's twenty-four kitchen tasks in a kitchen of our own, generated per seed."""
