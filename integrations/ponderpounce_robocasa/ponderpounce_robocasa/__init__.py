"""Plays the real RoboCasa-DC against PonderPounce, from RoboCasa's own environment."""
