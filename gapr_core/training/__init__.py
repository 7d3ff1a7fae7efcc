"""Where the truth meets the network: targets, losses and the trainer."""
