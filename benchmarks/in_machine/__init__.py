"""Programs that `benchmarks.reconvergence_udp_mesh` runs inside the machine of real radios, with its Python alone."""
