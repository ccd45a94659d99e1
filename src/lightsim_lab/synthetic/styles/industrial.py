from lightsim_lab.synthetic.styles.city import CITY as INDUSTRIAL
