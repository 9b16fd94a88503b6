"""Training: checkpointing, safeguards, callbacks, loggers, provenance."""
