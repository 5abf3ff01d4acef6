"""What the verbs read: views, masks, poses, models and cached results."""
