"""What every package needs of the machine: console, files, threads, settings, where a result comes from."""
