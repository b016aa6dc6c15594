"""The stages of the method: sets of pure functions to jit, vmap and compose."""
