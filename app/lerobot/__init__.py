"""Episodes of any kind as a LeRobot dataset (format v3), written by LeRobot itself."""
