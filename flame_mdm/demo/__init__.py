"""The page that asks for a motion in the browser; `flame-mdm demo` serves it."""
