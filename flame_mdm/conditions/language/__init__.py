"""Parsing of English prompts, independent of any model: actions, attributes and order."""
