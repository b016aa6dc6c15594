import jax
import pytest


@pytest.fixture(autouse=True)
def quick_compilation():
    """These programs run for a moment: most of a test's time would go into optimising them."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", before)
