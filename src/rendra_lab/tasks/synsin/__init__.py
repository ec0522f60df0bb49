"""SynSin: a new view from a single picture. Wiles, Gkioxari, Szeliski and Johnson, CVPR 2020."""
