"""Demonstrations in the formats of other libraries, read and written."""

from represent_jax.data.formats.registry import FORMATS, Format, find_format, read, write

__all__ = ["FORMATS", "Format", "find_format", "read", "write"]
