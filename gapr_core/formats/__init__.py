"""What comes from and goes to other tools: meshes, label maps, transforms, markups, tracker recordings."""
