"""DUSt3R and MASt3R: network, weights, and prediction of the pointmaps of image pairs."""
