"""Programs that benchmarks run inside the QEMU machine, with its own Python only."""
