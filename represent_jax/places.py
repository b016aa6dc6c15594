"""What nobody registered, by the place that Python imports it from."""

import importlib
from typing import Any

from represent_jax.errors import UsageError


def find(kind: str, place: str) -> Any:
    """Imports what stands at "module:name".

    Args:
        kind: what it is to be, for the error, for example "environment".
        place: the place.

    Raises:
        UsageError: there is no such module, or nothing of that name in it.
    """
    module, _, attribute = place.partition(":")
    try:
        return getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise UsageError(f"{kind} {place!r}: {error}") from error
