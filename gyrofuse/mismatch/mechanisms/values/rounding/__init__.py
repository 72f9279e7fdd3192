"""Values on a lattice: of rates, of angles, around zero alone, and with codes left out."""
