"""Robot side: an exported policy, a camera and a robot at 10 Hz. NumPy and onnxruntime, never JAX."""
