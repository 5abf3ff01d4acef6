"""The machine: processor, memory, threads, processes, clocks and signals."""
