"""What many results and recordings say together: the paper's protocol and claims, the information audit, similarity to real touch."""
