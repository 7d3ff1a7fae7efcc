"""Where hypotheses come from: each proposer gives poses, none of them decides."""
