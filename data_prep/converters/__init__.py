"""One module a data set; each gives scenes."""
