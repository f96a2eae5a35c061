"""Raw data sets become shards of graphs."""
