"""Procedural motions of the synthetic data set. One function per action moves the body."""
