"""What text to be read is made of: characters told apart without case, and common English words of four to ten letters."""

import string

_LIST = """
able about above across action after again against almost alone along already also always amount anger animal answer
anyone appear approach around arrive article attack autumn balance basket battle beauty because become before begin
behind believe better between beyond blanket blossom borrow bottle bottom branch bread breakfast breath bridge bright
bring brother brown budget build burning business butter button camera candle captain careful carry castle cattle
caught centre certain chance change chapter charge cheese children choice church circle citizen city classic clean
clear climb clock cloud coffee collect colour comfort common company complete concert control copper corner cotton
country couple courage cover create credit cross crowd culture curious current custom damage dance danger daughter
decide deep defend degree deliver depend desert design detail develop dinner direct discover disease distance doctor
dollar double dream dress drive during early earth easy economy education effect eight either electric element
engine enough entire equal escape evening event every example except exchange exercise expect explain express
extra family famous farmer father favour feather field fifteen fight figure final finger finish fire first flight
flower follow foot force foreign forest forget fortune forward found fourth fresh friday friend front fruit future
garden gather general gentle glass golden govern grass great green ground group growth guard guess guest guide
habit hammer hand happen happy harbour harvest health heart heavy height hello help highway history holiday honest
horse hospital hotel hour house human hundred hungry husband imagine important improve include increase industry
inform inside instead interest iron island jacket join journal journey judge juice jump justice keep kitchen knife
knowledge ladder language large laugh leader learn leather leave lesson letter level library light limit liquid
listen little local lonely look lost loud love lower lucky lunch machine magazine manage manner many market
marriage master matter maximum meal measure medicine meeting member memory message metal method middle might million
minute mirror mistake mixture modern moment money monkey month morning mother motor mountain movement much museum
music narrow nation nature nearly needle neighbour neither network never night nobody noise normal north nothing
notice number object ocean offer office often open opinion opposite orange order other outside over owner oxygen
paint palace paper parent park party passage patient pattern pause peace pencil people perfect period person
picture piece place plain planet plant plastic plate player please pocket point police polite popular position
possible potato power practice prepare present pretty prevent price print prison private problem produce program
promise proper protect proud public purple purpose quality quarter queen question quick quiet quite rabbit railway
rather reach ready reason receive record region regular relax remember repair repeat report request rescue respect
result return reward rhythm right river road rocket rough round royal rubber safety sailor salad salt sample
sand satisfy saturday scale school science season second secret section sentence separate serious service seven
several shadow shape sharp shelter shield ship shirt shoulder shout shower silence silver similar simple single
sister sixth skill sleep slowly smart smile smooth social soldier solid sometimes song south space speak special
speech spider spirit spoon spring square stage station steam stone storm story straight strange street strength
strong student subject success sudden sugar summer support surface surprise sweet swim symbol system table talent
target teacher temple tennis theatre thing think third thought thousand through thunder ticket tiger timber tomorrow
tongue tooth total touch toward tower traffic train travel treasure trouble trust truth twelve twenty umbrella
uncle under understand uniform unit until useful usual valley value vegetable vehicle village violin visit voice
volume wagon waiting warm wash watch water weapon weather wedding weekend weight welcome west wheel white whole
window winter wisdom without woman wonder wooden word work world worry worth write wrong yellow yesterday young
zebra zero
"""
WORDS: tuple[str, ...] = tuple(_LIST.split())

ALPHABET = string.digits + string.ascii_lowercase
