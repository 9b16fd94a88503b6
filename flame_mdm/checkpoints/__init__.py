"""Checkpoints and model files: reading, writing, loading, import of released weights, the hub."""
