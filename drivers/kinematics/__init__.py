"""Rigid transforms, serial chains, their derivatives and their inverse."""
