"""What many results and recordings say together: the paper's protocol and claims, information audit, similarity of touch."""
