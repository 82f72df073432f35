"""Import of real sensors' data sets, published or your own."""
