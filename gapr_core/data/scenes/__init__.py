"""A camera looks into a wound: bone at the bottom, soft tissue and instruments around it."""
