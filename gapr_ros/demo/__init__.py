"""`gapr demo`: a bag, the node, poses, a report."""
