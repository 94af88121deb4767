"""The test rig: an FR3 behind Franka's own network protocol, in a process of its own."""
