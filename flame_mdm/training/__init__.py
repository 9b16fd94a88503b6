"""Training: checkpointing, safeguards, callbacks, loggers and provenance."""
