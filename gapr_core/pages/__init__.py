"""What users look at: reports, plots and pictures."""
