"""What every room needs of the machine: console, threads, where a result comes from."""
