"""Parses English prompts into actions, attributes and order, independently of any model."""
