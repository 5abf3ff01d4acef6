"""What of a photograph is the object: each way a function from pixels to opacity."""
