"""Motion files for exchange with other programs. `docs/formats.md` lists units, axes and joints of each format."""
