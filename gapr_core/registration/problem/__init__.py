"""What is registered to what: source, target, sensor, and the checks of inputs."""
