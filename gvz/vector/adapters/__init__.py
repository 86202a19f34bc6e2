"""`gvz.make_vec` in the form that other libraries want: one module for each library, which must be installed."""
