"""SMPLify: a body fitted to the joints of a picture."""
