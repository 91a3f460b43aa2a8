"""CartPole and Acrobot: problems without a lie."""
