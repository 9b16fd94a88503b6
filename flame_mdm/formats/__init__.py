"""Motion files: what other programs read and write. `docs/formats.md` has units, axes and joints of each."""
