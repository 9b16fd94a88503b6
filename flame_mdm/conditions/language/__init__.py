"""English of prompts: the actions, attributes and order that a sentence asks for, whatever model reads it."""
