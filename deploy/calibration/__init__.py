"""Hand-eye calibration of the fixed camera: `ddgrasp calibrate`."""
