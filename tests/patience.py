"""How long tests wait for what has to happen; only what hangs takes longer."""

SECONDS = 1_200.0
