"""Files of other tools: meshes, label maps, transforms, markups, tracker recordings."""
