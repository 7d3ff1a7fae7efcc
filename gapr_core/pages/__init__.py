"""Output for users: reports, plots and pictures."""
