"""Objects to data sets: `generate` sends the objects of a source through workers into the files of a layout."""
