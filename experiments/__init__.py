"""Launchers: they parse flags, call the package and save."""
