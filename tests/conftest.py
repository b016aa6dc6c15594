"""XLA's settings for all tests and the programs that they start, made before JAX is imported."""

import os

# Programs of tests are small and run once: their time is the compiler's. Without optimisation and
# with less fusion it takes a third to a half of it. Whoever sets XLA_FLAGS is left alone.
os.environ.setdefault(
    "XLA_FLAGS", "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
)
