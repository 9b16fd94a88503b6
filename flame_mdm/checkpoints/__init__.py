"""Checkpoints and model files: reading, writing, loading, import of released weights, and upload."""
