"""Registration of a camera's cloud, most of which may not be bone."""
