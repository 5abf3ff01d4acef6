"""Generation of data sets: workers render the objects of a source and write the files of a layout."""
