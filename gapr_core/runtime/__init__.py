"""Access to the machine for all packages: console, files, threads, settings, where a result comes from."""
