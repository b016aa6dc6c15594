"""The figures of the paper's Tables I to V (RA-L 2025), to be shown beside ours.

By domain, target and method: mean and standard deviation of correlations, means of returns.
"""

_HOPPER, _CHEETAH, _PENDULUM = "hopper", "half_cheetah", "inverted_double_pendulum"

# Table I: pooled Pearson correlation, mean and standard deviation of five seeds.
CORRELATIONS: dict[tuple[str, str, str], tuple[float, float]] = {
    (_HOPPER, "task", "represent"): (0.949, 0.002),
    (_HOPPER, "task", "ssrr"): (0.578, 0.057),
    (_HOPPER, "task", "msrd"): (0.551, 0.071),
    (_HOPPER, "task", "drex"): (0.649, 0.058),
    (_HOPPER, "strategy_1", "represent"): (0.938, 0.003),
    (_HOPPER, "strategy_1", "ssrr"): (0.933, 0.017),
    (_HOPPER, "strategy_1", "msrd"): (0.653, 0.045),
    (_HOPPER, "strategy_2", "represent"): (0.957, 0.004),
    (_HOPPER, "strategy_2", "ssrr"): (0.916, 0.031),
    (_HOPPER, "strategy_2", "msrd"): (0.704, 0.142),
    (_CHEETAH, "task", "represent"): (0.929, 0.003),
    (_CHEETAH, "task", "ssrr"): (0.821, 0.058),
    (_CHEETAH, "task", "msrd"): (0.709, 0.069),
    (_CHEETAH, "task", "drex"): (0.779, 0.067),
    (_CHEETAH, "strategy_1", "represent"): (0.930, 0.003),
    (_CHEETAH, "strategy_1", "ssrr"): (0.913, 0.038),
    (_CHEETAH, "strategy_1", "msrd"): (0.627, 0.018),
    (_CHEETAH, "strategy_2", "represent"): (0.928, 0.004),
    (_CHEETAH, "strategy_2", "ssrr"): (0.912, 0.024),
    (_CHEETAH, "strategy_2", "msrd"): (0.656, 0.107),
    (_PENDULUM, "task", "represent"): (0.999, 0.000),
    (_PENDULUM, "task", "ssrr"): (-0.269, 0.789),
    (_PENDULUM, "task", "msrd"): (-0.303, 0.750),
    (_PENDULUM, "task", "drex"): (-0.393, 0.782),
    (_PENDULUM, "strategy_1", "represent"): (0.999, 0.000),
    (_PENDULUM, "strategy_1", "ssrr"): (0.434, 0.825),
    (_PENDULUM, "strategy_1", "msrd"): (-0.361, 0.668),
    (_PENDULUM, "strategy_2", "represent"): (0.999, 0.000),
    (_PENDULUM, "strategy_2", "ssrr"): (0.946, 0.074),
    (_PENDULUM, "strategy_2", "msrd"): (-0.269, 0.703),
}

# Table II: true return of the best policy, and of the demonstrators.
RETURNS: dict[tuple[str, str, str], float] = {
    (_HOPPER, "strategy_1", "demonstrators"): 1197.93,
    (_HOPPER, "strategy_1", "represent"): 1316.01,
    (_HOPPER, "strategy_1", "ssrr"): 1187.50,
    (_HOPPER, "strategy_1", "msrd"): 1149.11,
    (_CHEETAH, "strategy_1", "demonstrators"): 1243.13,
    (_CHEETAH, "strategy_1", "represent"): 3930.14,
    (_CHEETAH, "strategy_1", "ssrr"): -256.09,
    (_CHEETAH, "strategy_1", "msrd"): 1201.08,
    (_PENDULUM, "strategy_1", "demonstrators"): 861.84,
    (_PENDULUM, "strategy_1", "represent"): 9350.52,
    (_PENDULUM, "strategy_1", "ssrr"): 9290.24,
    (_PENDULUM, "strategy_1", "msrd"): 29.67,
    (_HOPPER, "strategy_2", "demonstrators"): 1587.98,
    (_HOPPER, "strategy_2", "represent"): 2893.47,
    (_HOPPER, "strategy_2", "ssrr"): 1563.45,
    (_HOPPER, "strategy_2", "msrd"): 1443.17,
    (_CHEETAH, "strategy_2", "demonstrators"): 1172.71,
    (_CHEETAH, "strategy_2", "represent"): 3860.52,
    (_CHEETAH, "strategy_2", "ssrr"): 2013.79,
    (_CHEETAH, "strategy_2", "msrd"): 1410.34,
    (_PENDULUM, "strategy_2", "demonstrators"): 1217.65,
    (_PENDULUM, "strategy_2", "represent"): 9350.47,
    (_PENDULUM, "strategy_2", "ssrr"): 9315.36,
    (_PENDULUM, "strategy_2", "msrd"): 29.82,
    (_HOPPER, "task", "demonstrators"): 1392.96,
    (_HOPPER, "task", "represent"): 1692.14,
    (_HOPPER, "task", "drex"): 0.91,
    (_HOPPER, "task", "bc"): 1102.19,
    (_HOPPER, "task", "bc_rnn"): 187.20,
    (_CHEETAH, "task", "demonstrators"): 1207.92,
    (_CHEETAH, "task", "represent"): 3540.06,
    (_CHEETAH, "task", "drex"): 3148.64,
    (_CHEETAH, "task", "bc"): 960.12,
    (_CHEETAH, "task", "bc_rnn"): 799.44,
    (_PENDULUM, "task", "demonstrators"): 1039.75,
    (_PENDULUM, "task", "represent"): 9350.50,
    (_PENDULUM, "task", "drex"): 83.00,
    (_PENDULUM, "task", "bc"): 722.88,
    (_PENDULUM, "task", "bc_rnn"): 129.96,
}

# Table III: true return on Hopper without one of the losses.
ABLATIONS: dict[tuple[str, str], float] = {
    ("strategy_1", "represent"): 1316.01,
    ("strategy_1", "no_reg"): 1090.03,
    ("strategy_1", "no_bcd"): 1214.00,
    ("strategy_1", "ssrr"): 1187.5,
    ("strategy_2", "represent"): 2893.47,
    ("strategy_2", "no_reg"): 2269.25,
    ("strategy_2", "no_bcd"): 2000.38,
    ("strategy_2", "ssrr"): 1563.45,
    ("task", "represent"): 1692.14,
    ("task", "no_reg"): 1785.19,
    ("task", "no_bcd"): 1633.13,
}

# Table IV: Franka Kitchen; every strategy's line shows the one task policy.
KITCHEN: dict[tuple[str, str], float] = {
    ("strategy_1", "demonstrators"): -122.86,
    ("strategy_1", "represent"): -121.94,
    ("strategy_1", "bc"): -467.95,
    ("strategy_2", "demonstrators"): -174.46,
    ("strategy_2", "represent"): -169.20,
    ("strategy_2", "bc"): -528.68,
    ("task", "represent"): -106.48,
}

# Table V: three strategies on HalfCheetah.
THREE_STRATEGIES: dict[tuple[str, str], float] = {
    ("strategy_1", "demonstrators"): 1243.13,
    ("strategy_1", "represent"): 2279.29,
    ("strategy_2", "demonstrators"): 1172.71,
    ("strategy_2", "represent"): 3220.52,
    ("strategy_3", "demonstrators"): 1181.35,
    ("strategy_3", "represent"): 2664.76,
    ("task", "demonstrators"): 1199.06,
    ("task", "represent"): 2901.24,
}
