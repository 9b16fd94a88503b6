"""Checkpoints and model files: reading, writing, loading, importing and uploading."""
